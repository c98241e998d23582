"""Commands of the studies: many questions about one scene, a record, or a catalogue."""
