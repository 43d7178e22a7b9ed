"""Operations, bytes, concatenates and scatters of typical programs next to the committed counts; `--update` commits to them.

    python -m benchmarks counts [--update]

The counts are those that `tests/test_program_size.py` holds programs to: lowered, not compiled, so that a minute is enough.
"""

import runpy
import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1] / "tests"


def main() -> None:
    """Show the counts, or write them."""
    sys.path.insert(0, str(TESTS))
    sys.argv[0] = str(TESTS / "test_program_size.py")
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
