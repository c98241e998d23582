"""Compiler settings, caches of compiled programs, devices and threads."""
