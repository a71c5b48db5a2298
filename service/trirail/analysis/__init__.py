"""Analysis of recordings: summaries, charts, replays."""
