"""Studies: many simulated fleets, many methods, and what follows from their scores."""
