"""Audit of a scene: influence and cost of its effects and of the tiers, and effects that it may lack."""
