"""Networks that other people trained, as image makers: SSML, SSIR, SpikeCLIP and SCFlow."""
