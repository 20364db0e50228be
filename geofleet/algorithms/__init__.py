"""Pure algorithms: arrays and plain numbers in, frozen dataclasses out; nothing here knows a file, table or config."""
