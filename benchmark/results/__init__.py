"""Predictions folders, which methods hand in, and the result records that the judge makes of them."""
