"""`python -m patchlab`."""

from patchlab.cli import main

main()
