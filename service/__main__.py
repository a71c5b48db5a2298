"""`python -m service` is `trirail`."""

from service.cli import main

main()
