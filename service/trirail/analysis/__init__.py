"""Analysis of recordings: summaries, charts, exports and replays."""
