"""Training of MSDI: data, losses, the loop, evaluation, the model card."""
