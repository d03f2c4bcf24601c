"""Flights and captures of windhover as pandas tables and NumPy arrays."""

from .flight import KINDS, Flight, Frame

__all__ = ["KINDS", "Flight", "Frame"]
