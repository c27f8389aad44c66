"""The referee: controls of anybody's solver judged, and a leaderboard of them; begin with `judge.py`.

Only data is read: arrays without pickles, CSV and TOML. No code of an entry runs.
"""
