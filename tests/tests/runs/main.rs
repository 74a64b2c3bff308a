//! Whole runs, and what is kept of them: what no backend changes.

mod checkpoints;
mod corrections;
mod determinism;
mod known_camera;
mod lengths;
mod opened;
mod shots;
