"""Missions in space that the vehicle hasn't seen: paths on its map, corridors, plans that come to rest where it is free."""
