"""The outside world: readers and writers of files that geofleet does not own."""
