"""Flow of whole fleets of logs: shards, workers, resuming, engines."""
