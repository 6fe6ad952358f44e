"""Contacts: pairs of geoms and contact points, the force law and its softness, and the depth at rest."""

from mjxgrad.contact.parameters import ContactPair, ContactParameters, contact_pairs, contact_parameters
from mjxgrad.contact.softness import Softness
from mjxgrad.contact.warnings import softness_warnings

__all__ = ["ContactPair", "ContactParameters", "Softness", "contact_pairs", "contact_parameters", "softness_warnings"]
