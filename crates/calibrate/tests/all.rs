//! The integration tests, in one program: to link one for each file takes longer than most of them run.
#![allow(missing_docs, clippy::unwrap_used)]

mod carry;
mod common;
mod input_noise;
mod inputs;
mod missing_channel;
mod nist;
mod noise;
mod range;
mod starts;
mod stiff;
mod strides;
mod undefined;
mod units;
mod work;
