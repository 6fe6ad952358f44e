"""What is known of a contact or limit without stepping: who can touch, the law of its force, how soft it is, where it rests."""

from mjxgrad.contact.parameters import ContactPair, ContactParameters, contact_pairs, contact_parameters
from mjxgrad.contact.softness import Softness
from mjxgrad.contact.warnings import softness_warnings

__all__ = ["ContactPair", "ContactParameters", "Softness", "contact_pairs", "contact_parameters", "softness_warnings"]
