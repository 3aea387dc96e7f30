"""Robot League's learning: policies that act in JAX and learn in torch, and the learners that train them."""
