//! The integration tests, in one program: to link one for each file takes longer than most of them run.
#![allow(missing_docs, clippy::unwrap_used)]

mod blocks;
mod dead_time;
mod invariance;
mod machines;
mod recovery;
