"""Networks beside the actor and the critics: context estimator, discriminator, exported policy."""
