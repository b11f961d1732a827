//! Chapter 4: control of what was identified.

use super::Entry;
use super::{optimal, sliding};

/// Its tables and figures, in order.
pub(crate) fn entries() -> Vec<Entry> {
    vec![
        Entry::new("Figure 4.1", sliding::figure_4_1),
        Entry::new("Figure 4.2", sliding::figure_4_2),
        Entry::new("Figure 4.3", optimal::figure_4_3),
        Entry::new("Figure 4.4", optimal::figure_4_4),
        Entry::new("Figure 4.5", optimal::figure_4_5),
        Entry::new("Table 4.1", optimal::table_4_1),
        Entry::new("Figure 4.6", optimal::figure_4_6),
        Entry::new("Figure 4.7", optimal::figure_4_7),
        Entry::new("Figure 4.8", optimal::figure_4_8),
        Entry::new("Figure 4.9", optimal::figure_4_9).slow(),
        Entry::new("Figure 4.10", optimal::figure_4_10),
    ]
}
