"""One vocabulary for the signs of every scheme: `taxonomy.csv` and its reader."""

from geofleet.taxonomy.reader import Classified, Concept, Meaning, Taxonomy, load_taxonomy

__all__ = ["Classified", "Concept", "Meaning", "Taxonomy", "load_taxonomy"]
