//! Each fault of the bus is reported with the same code everywhere: in status, page, metrics, log and recording.

use std::io;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ballbard::control::status::ServiceState;
use serde_json::json;

use super::rig::live_on_bus;
use crate::support::world::sleep;
use crate::support::{has_problem, is_in_metrics};

/// A writer that collects the log of this thread in memory.
#[derive(Clone, Default)]
struct Log(Arc<Mutex<Vec<u8>>>);

impl Log {
    fn text(&self) -> String {
        String::from_utf8(self.0.lock().unwrap().clone()).unwrap()
    }
}

impl io::Write for Log {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn check(faults: &'static [&'static str], code: &'static str) {
    let log = Log::default();
    let writer = log.clone();
    let lines = tracing_subscriber::fmt().with_ansi(false).with_writer(move || writer.clone()).finish();
    let _guard = tracing::subscriber::set_default(lines);
    live_on_bus(faults, async move |day| {
        day.wait_for(ServiceState::Waiting).await;
        assert_eq!(day.post("/start", &json!({"name": "run", "reason": "a test"})).await.0, 200);
        let status = day.wait(Duration::from_secs(60), |status| has_problem(status, code)).await;
        assert!(has_problem(&status, code), "{code} is not in the status: {status:?}");
        // The page may lag behind the status by up to a tenth of a second.
        sleep(Duration::from_millis(200)).await;
        let page = day.text("/api/live").await;
        assert!(page.contains(&format!("\"code\":\"{code}\"")), "{code} is not on the page: {page}");
        let metrics = day.text("/metrics").await;
        assert!(is_in_metrics(&metrics, code), "{code} is not in {metrics}");
        assert!(log.text().contains(&format!("code=\"{code}\"")), "{code} is not in the log: {}", log.text());
        // Cycles without samples are written to the file only when samples return.
        day.wait(Duration::from_secs(60), |status| status.problems.is_empty()).await;
        day.post("/stop", &json!({})).await;
        let events = day.recording("run").events;
        assert!(events.iter().any(|event| event.code == code), "{code} is not in the file: {events:?}");
        day.end().await;
    });
    println!("| {:<40} | {code:<20} | status, page, metrics, log, file |", faults.join(" "));
}

#[test]
fn each_fault_of_the_bus_has_the_same_code_wherever_it_is_reported() {
    // Two faults are not tested here: a step of the bus clock, and a terminal in SAFE-OP. Both end
    // before a status shows them.
    let cases: [(&[&str], &str); 7] = [
        (&["gone:3@7s-9s"], "bus_device_missing"),
        (&["gone:0@7s-9s"], "bus_no_answer"),
        (&["link-down@7s-9s"], "bus_no_answer"),
        (&["short:1,3@7s-9s"], "bus_bad_replies"),
        (&["gone:3@7s-8s", "abort:1,0x06090011@7s-9s"], "bus_setting_refused"),
        (&["no-signal:2@7s-9s"], "encoder_invalid"),
        (&["noise:3,0.05@2s"], "link_errors"),
    ];
    for (faults, code) in cases {
        check(faults, code);
    }
}
