"""Studies of many cases of a scene: labelled results on disk, resumable, on one machine or several."""
