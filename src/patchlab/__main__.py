"""Entry point of the laboratory's command line, also as `python -m patchlab`."""

from functools import partial

from patchproof.__main__ import main as run

main = partial(run, "patchlab.cli")
if __name__ == "__main__":
    main()
