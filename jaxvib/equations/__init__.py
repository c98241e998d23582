"""The one place where a scene becomes equations: full, averaged, linear, forces."""
