"""One vocabulary of traffic signs."""
