//! The Rust code of the book's pages, compiled and run by `cargo test --doc --package example-book`.

/// A folder of recordings.
#[cfg(doctest)]
#[doc = include_str!("../../../docs/src/folders.md")]
struct Folders;
