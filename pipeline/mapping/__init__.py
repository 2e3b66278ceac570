"""The target's marker map, estimated from views that show several of its markers together."""
