"""``python tests/fuzz --only toml --count 200 --seed 1`` runs 200 scenario files; without arguments, all 8100 cases run."""

import os
import sys
from pathlib import Path

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
os.environ.update(dict.fromkeys(ONE_THREAD, "1"))  # before NumPy is imported: threads do not survive a fork
sys.path[0] = str(Path(__file__).resolve().parents[1])

if __name__ == "__main__":
    from fuzz.driver import main

    sys.exit(min(main(), 1))
