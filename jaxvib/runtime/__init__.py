"""Compiler settings and compiled programs kept on disk."""
