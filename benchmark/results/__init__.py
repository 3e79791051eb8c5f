"""What methods hand in and what the judge makes of it: predictions folders, result records, scores."""
