"""Archives for the public leaderboards, versions 1 and 3: written, packed and checked."""
