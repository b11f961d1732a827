//! Numbers that begin where a cache line does: rows of vectors are then never split over two.

use std::ops::{Deref, DerefMut};

/// Bytes of a cache line, and of the widest vectors.
const LINE: usize = 64;

/// A slice of numbers at the beginning of a cache line.
#[derive(Debug)]
pub(crate) struct Aligned {
    numbers: Vec<f64>,
    from: usize,
    len: usize,
}

impl Aligned {
    /// `len` zeros.
    pub(crate) fn zeros(len: usize) -> Aligned {
        let numbers = vec![0.0; len + LINE / size_of::<f64>()];
        // (Where the address tells nothing, any beginning is right.)
        let from = numbers.as_ptr().align_offset(LINE).min(LINE / size_of::<f64>());
        Aligned { numbers, from, len }
    }
}

impl Deref for Aligned {
    type Target = [f64];

    #[inline(always)]
    fn deref(&self) -> &[f64] {
        &self.numbers[self.from..self.from + self.len]
    }
}

impl DerefMut for Aligned {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut [f64] {
        &mut self.numbers[self.from..self.from + self.len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn begins_with_a_cache_line_and_holds_what_was_asked() {
        for len in [0, 1, 7, 64, 1000] {
            let mut a = Aligned::zeros(len);
            assert_eq!(a.len(), len);
            assert_eq!(a.as_ptr() as usize % LINE, 0);
            a.fill(1.0);
            assert!(a.iter().all(|x| *x == 1.0));
        }
    }
}
