"""What effects and tiers are worth on a scene: what each changes, what it costs, which are missing."""
