//! Recordings of experiments: time series with units, CSV reader, data health, smoothing.
