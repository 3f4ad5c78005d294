"""The command line `halfspace-sss`, one file per command."""

__all__ = ["main"]


def main() -> None:
    """Run the command line; the entry point of `halfspace-sss`."""
    from halfspace_sss.cli import app

    app.main()
