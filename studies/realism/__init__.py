"""`report realism`: can a classifier tell a real camera's spikes from simulated ones of equal rates?"""
