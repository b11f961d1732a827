//! The integration tests, in one program: to link one for each file takes longer than most of them run.
#![allow(missing_docs, clippy::unwrap_used)]

mod common;
mod floor;
mod handed_back;
mod horizons;
mod inputs;
mod invariance;
mod kinds;
mod proposed;
mod recovery;
mod shapes;
mod twins;
