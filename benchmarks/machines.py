"""Machines of the papers, and the tables of the torus paper, imported from the tests that compare them with printed numbers."""

import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "tests" / "validation"))

from papers.machines import published_rotor, published_torus
from papers.torus_tables import CONTACT, MODELS, published_tables

__all__ = ["CONTACT", "MODELS", "published_rotor", "published_tables", "published_torus"]
