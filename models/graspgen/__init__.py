"""A small diffusion generator of grasps with a learned discriminator, and all that is needed to train it."""
