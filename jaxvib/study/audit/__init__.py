"""Audit of effects and tiers on a scene: their changes, their cost, and missing effects."""
