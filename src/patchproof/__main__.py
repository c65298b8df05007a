"""Entry point of the command line, also as `python -m patchproof`."""

from patchproof.app.interrupt import handle_interrupts


def main() -> None:
    """Run the command line, which Ctrl-C ends even while it is being imported."""
    handle_interrupts()
    from patchproof.app.cli import main

    main()


if __name__ == "__main__":
    main()
