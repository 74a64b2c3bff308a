//! Scenes as folders: good ones in each layout, broken ones, and the real ones where they are there.
#![expect(
    clippy::unwrap_used,
    reason = "a test that cannot make its input has failed"
)]

mod broken;
mod d2rf;
mod distorted;
mod dyblurf;
mod dycheck;
mod exposure;
mod images;
mod make;
mod masks;
mod megasam;
mod nerfstudio;
mod real;
mod shape_of_motion;
mod vipe;
