//! The integration tests, in one program: to link one for each file takes longer than most of them run.
#![allow(missing_docs, clippy::unwrap_used)]

mod bounded;
mod common;
mod errors;
mod link;
mod loops;
mod output;
mod plants;
mod rest;
mod start;
mod trajectories;
