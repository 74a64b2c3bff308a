//! What the repository's documents and sources promise of each other.

mod circles;
mod examples;
mod reliability;
