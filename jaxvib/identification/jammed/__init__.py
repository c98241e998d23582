"""Fits of machines whose loads move on a rotor of known angle, such as balls that are jammed at a resonance."""
