//! bpnet
