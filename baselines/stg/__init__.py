"""baselines/stg."""
