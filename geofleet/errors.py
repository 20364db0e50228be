"""Every error that geofleet raises on purpose.

```
GeofleetError             the command line prints it as one message and exits with 2
├── InputError            a file or table from outside cannot be used
│   └── TableError        a table does not have the schema of its name
├── ConfigError           a key, value or option is unknown, out of range or contradicts another
└── QueryError            an SQL statement failed
```

A message says what is wrong, where, and what to do next, in that order.
"""

from __future__ import annotations

# Begins the name of a count that is a warning: what can hardly be true, and yet is no error
SUSPICIOUS = "SUSPICIOUS: "


class GeofleetError(Exception):
    """Base of all errors whose message is meant for the user.

    Parameters
    ----------
    what
        What is wrong, in one sentence.
    where
        File, line, element, column or row count.
    todo
        What to do next.
    """

    is_one_line = True

    def __init__(self, what: str, *, where: str = "", todo: str = "") -> None:
        if self.is_one_line:  # texts of a damaged file may hold anything
            what, where, todo = ("".join(c if c.isprintable() else " " for c in one) for one in (what, where, todo))
        self.what, self.where, self.todo = what, where, todo
        super().__init__(" ".join(part for part in (f"{where}: {what}" if where else what, todo) if part))


class InputError(GeofleetError):
    """A file or table from outside cannot be used."""


class TableError(InputError):
    """A table does not have the schema of its name."""


class ConfigError(GeofleetError):
    """A key, value or option is unknown, out of range or contradicts another."""


class QueryError(GeofleetError):
    """An SQL statement failed; the message shows it."""

    is_one_line = False
