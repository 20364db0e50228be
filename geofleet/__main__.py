"""`python -m geofleet` is the `geofleet` command."""

from geofleet.cli import main

main()
