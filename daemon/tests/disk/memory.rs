//! Drawing a run of several days, or exporting it as a table, needs no more memory than for a short run.

use std::io;

use ballbard::control::recordings::runs::curves;
use ballbard::control::recordings::table::{Layout, write_csv};
use shared::recording::SystemDisk;

use crate::no_allocation::peak_bytes;
use crate::support::runs::leave;

#[test]
fn what_a_plot_or_a_table_holds_does_not_grow_with_the_run() {
    // The additional cycles of the long run take 9 MB of records.
    let (short, long) = (600, 60_000);
    let directory = tempfile::tempdir().unwrap();
    let peaks = [short, long].map(|cycles| {
        let name = format!("of-{cycles}");
        leave(directory.path(), &name, cycles, true);
        let file = directory.path().join(format!("{name}.mcap"));
        let plot = peak_bytes(|| {
            let curves = curves(&SystemDisk, &file).unwrap();
            assert!((500..=1500).contains(&curves.t_s.len()));
        });
        let table = peak_bytes(|| {
            assert_eq!(write_csv(&SystemDisk, &file, Layout::default(), io::sink()).unwrap(), cycles);
        });
        [plot, table]
    });
    let [short, long] = peaks;
    for (what, (short, long)) in ["plot", "table"].into_iter().zip(short.into_iter().zip(long)) {
        assert!(long - short < 1 << 20, "{what}: {long} bytes against {short}");
    }
}
