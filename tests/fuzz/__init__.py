"""Wrong input by the thousand: ``python tests/fuzz``. Each case is one command line, run in a child process with limits."""
