"""Write, zip and check archives for the public leaderboards, versions 1 and 3."""
