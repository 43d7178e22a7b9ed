"""`python -m benchmarks [NAME ...] [--quick] [--peers] [--again] [--out DIR]`: the suite, some workloads of it, or a study.

Without a name all workloads run: what physjax and, with `--peers`, other codes make of the same problems. A study is asked for
by its name. What is finished on this machine with these versions is skipped. `report` writes README.md and its charts from
the results files, `counts` the committed operation counts.
"""

import ast
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
sys.path.insert(0, str(FOLDER))
SHARED = ("__main__", "harness", "rivals", "cuda", "suite", "measures", "report", "charts", "counts", "adapter")
"""Modules that are no benchmarks themselves."""


def list_studies() -> dict[str, str]:
    """The studies, and the first line of what each says of itself."""
    return {file.stem: read_title(file) for file in sorted(FOLDER.glob("*.py")) if file.stem not in SHARED}


def read_title(file: Path) -> str:
    """The first line of a module's docstring."""
    return (ast.get_docstring(ast.parse(file.read_text())) or "").partition("\n")[0]


def main() -> None:
    """Run what is named, or all workloads."""
    if sys.argv[1:2] in (["report"], ["counts"]):
        name = sys.argv.pop(1)
        module = __import__(name)
        raise SystemExit(module.main())
    import harness
    import suite

    studies = list_studies()
    about = {name: read_title(FOLDER / "workloads" / f"{name}.py") for name in suite.WORKLOADS}
    listed = "\n".join(["workloads:", *_list(about), "studies:", *_list(studies), "and: report, counts"])
    parser = harness.build_parser(f"{__doc__}\n\n{listed}")
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="a workload or a study; all workloads if none is named"
    )
    parser.add_argument("--peers", action="store_true", help="with other codes next to physjax (the extra `bench`)")
    parser.add_argument("--slow", action="store_true", help="with peers that take minutes to compile")
    parser.add_argument("--again", action="store_true", help="measure what is finished as well")
    given = harness.parse_arguments(parser)
    for name in given.names:
        if name not in about | studies:
            parser.error(f"got {name!r}, expected a workload or a study.\n{listed}")
    raise SystemExit(suite.run_names(given.names or list(suite.WORKLOADS), given))


def _list(found: dict[str, str]) -> list[str]:
    return [f"  {name:12} {about}" for name, about in found.items()]


if __name__ == "__main__":
    main()
