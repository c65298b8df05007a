"""Entry point of `python -m patchlab`."""

from patchlab.cli import main

main()
