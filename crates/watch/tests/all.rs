//! The integration tests, in one program: to link one for each file takes longer than most of them run.
#![allow(missing_docs, clippy::unwrap_used)]

mod delayed;
mod drive;
