"""Learners: the interface of all of them, and HAPPO: actors, critics, advantages, optimizer, trust region, checkpoints.

The course of an update, whose algorithm is `agents.learner.happo.HappoLearner.learn`:

- All T·N decisions take part, with a weight of 1 or 0, so that shapes depend neither on deaths nor on void decisions.
  Whatever a decision of weight 0 holds is replaced by zeros first (`agents.batch.clean`), since 0 times NaN is NaN.
- Each pass goes through all rows in a random order of its own. A minibatch gives the mean over its valid rows; without
  one it changes neither weights, moments, step counts nor the value normaliser.
- Random numbers: `HappoLearner.rng`, on the CPU, is part of the checkpoint. From it each update draws the order of
  agents and one seed of a generator on the learner's device, which draws the orders of rows. So a checkpoint moves
  between CPU and GPU, and equal checkpoints give equal bytes on one device, though not on two.
- On a GPU the repeated parts are replayed as CUDA graphs (`agents.devices.cuda_graphs`): evaluation by each critic, the
  standardised advantages, each pass with all its minibatches and metrics, and an actor's batch and log densities before
  and after it. HATRPO's step and the products of M are launched kernel by kernel. The device is read only to refuse a
  bad batch, after each pass under `target_kl`, and for the metrics at the end.
- Critics learn from their values before the update, and actors do not use them afterwards. Therefore critics and actors
  learn at the same time, on two streams.
- With `learner.compiled` torch.compile fuses losses, gradients and Adam's steps. Messages between ranks and
  `desired_kl` stay outside compiled code.
"""
