"""Recordings looked at afterwards: summaries, charts, replays."""
