"""`python -m patchproof`."""

from patchproof.cli import main

main()
