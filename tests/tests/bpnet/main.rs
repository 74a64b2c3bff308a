//! BP-Net and its ops on every backend.

mod blur;
mod deblur;
mod devices;
mod net;
