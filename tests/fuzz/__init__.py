"""Fuzzing with thousands of wrong inputs: ``python tests/fuzz``. Each case is a command line, run in a limited child process."""
