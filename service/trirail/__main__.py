"""`python -m trirail` is `trirail`."""

from trirail.cli.commands import main

main()
