"""`python -m patchproof`."""

from patchproof.app.cli import main

main()
