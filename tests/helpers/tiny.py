"""The smallest training run that goes through everything."""

TINY = [
    "env=planar4dof",
    "env.demonstrations.count=4",
    "env.demonstrations.held_out=2",
    "trainer.num_envs=64",
    "trainer.batch_size=32",
    "trainer.num_minibatches=4",
    "trainer.num_updates_per_batch=1",
    "trainer.hidden_layers=[16]",
    "trainer.num_timesteps=5000",
    "trainer.evaluations=4",
]
