"""Results of episodes and studies: metrics, outcomes, statistics, summaries."""
