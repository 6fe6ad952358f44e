"""Contacts: pairs of geoms and contact points, the force law and its softness, and the depth at rest."""

from mjxgrad.contact.softness import Softness
from mjxgrad.contact.warnings import softness_warnings
