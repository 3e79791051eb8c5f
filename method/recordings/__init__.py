"""`fit`: from a recording to a 4D model, a video and a report, without ground truth."""
