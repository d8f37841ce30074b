"""Run the command ``marlbc`` as ``python -m marlbc_mj``."""

from marlbc_mj.cli import main

if __name__ == "__main__":
    main()
