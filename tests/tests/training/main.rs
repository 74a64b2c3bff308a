//! Training on every backend, on the tiny scene.

mod coverage;
mod devices;
mod gradients;
mod guard;
mod scenes;
mod steps;
