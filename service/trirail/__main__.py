"""`python -m trirail` is `trirail`."""

from trirail.cli.cli import main

main()
