"""Contacts: which geoms can touch and where they do, the law of the force, how soft it is, where a body rests."""

from mjxgrad.contact.parameters import ContactPair, ContactParameters, contact_pairs, contact_parameters
from mjxgrad.contact.softness import Softness
from mjxgrad.contact.warnings import softness_warnings

__all__ = ["ContactPair", "ContactParameters", "Softness", "contact_pairs", "contact_parameters", "softness_warnings"]
