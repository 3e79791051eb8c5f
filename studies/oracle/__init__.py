"""The ladder of oracles: fits that are given one thing more than a method may have, and what each gains."""
