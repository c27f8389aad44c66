"""Missions in space that the vehicle has not seen: paths on its map, corridors, plans that stop where it is free."""
