"""Studies of many cases of a scene, with labelled results on disk. A study can be interrupted and continued, and can use
several machines."""
