"""`python -m benchmarks NAME [--quick] [--out DIR]`: one of the benchmarks of this folder, or the list of them."""

import ast
import runpy
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
SHARED = ("__main__", "harness", "rivals", "cuda")
"""Modules that are not benchmarks themselves."""


def list_benchmarks() -> dict[str, str]:
    """The benchmarks, and the first line of what each says of itself."""
    files = {file.stem: file for file in sorted(FOLDER.glob("*.py")) if file.stem not in SHARED}
    return {
        name: (ast.get_docstring(ast.parse(file.read_text())) or "").partition("\n")[0] for name, file in files.items()
    }


def main() -> None:
    """Run the benchmark that is named first, with the options after it."""
    found, name = list_benchmarks(), sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in found:
        lines = [f"  {key:12} {about}" for key, about in found.items()]
        print("\n".join(["python -m benchmarks NAME [--quick] [--out DIR]", *lines]))
        raise SystemExit(0 if name in ("", "-h", "--help") else f"got {name!r}, expected one of those names.")
    sys.path.insert(0, str(FOLDER))
    sys.argv = [f"python -m benchmarks {name}", *sys.argv[2:]]
    runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")


if __name__ == "__main__":
    main()
