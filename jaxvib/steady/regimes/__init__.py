"""Synchronous regimes of several exciters: speeds, phases, stability and margins."""
