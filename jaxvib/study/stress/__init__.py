"""Hard cases, each with an independent reference: whether answers stay right, or say by name why there is none."""
