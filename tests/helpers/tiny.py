"""A planar pair that compiles quickly, and the settings of the smallest training run that uses every part."""

SHORT_ARMS = {"expert": {"link_lengths": [0.4, 0.3, 0.3]}, "learner": {"link_lengths": [0.5, 0.5]}}
TINY = [
    "env=planar4dof",
    "env.expert.link_lengths=[0.4,0.3,0.3]",
    "env.learner.link_lengths=[0.5,0.5]",
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
ENDLESS = ["trainer.num_timesteps=100000000", "trainer.evaluations=20000"]  # with many checkpoints
