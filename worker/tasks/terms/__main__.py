"""``python -m worker.tasks.terms`` writes the page of all terms; with ``porting``, the page of mjlab's and Isaac Lab's names."""

from __future__ import annotations

import sys

from worker.tasks.terms.catalogue import porting, reference

PAGES = {"reference": reference, "porting": porting}


def main(arguments: list[str]) -> None:
    """Print a page. Exits with one line where it is unknown."""
    name = arguments[0] if arguments else "reference"
    if name not in PAGES:
        sys.exit(f"python -m worker.tasks.terms: there is no page {name!r}; there are {', '.join(PAGES)}")
    sys.stdout.write(PAGES[name]())


if __name__ == "__main__":
    main(sys.argv[1:])
