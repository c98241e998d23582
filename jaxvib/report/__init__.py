"""Results for people who were not there: one web page with all of it, and what the parts of a scene file take."""
