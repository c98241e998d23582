"""Studies of many cases of a scene: labelled, kept on disk, resumed where they stopped, on one machine or several."""
