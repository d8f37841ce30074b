"""``python -m marlbc_mj`` is ``marlbc``."""

from marlbc_mj.cli import main

if __name__ == "__main__":
    main()
