"""What an episode or a study came to: metrics, outcomes, statistics, summaries."""
