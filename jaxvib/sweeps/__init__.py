"""Studies of many cases of a scene, with labelled results on disk; they can be continued, and use one machine or several."""
