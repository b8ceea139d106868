//! Lines of a flood, as they are written.

use super::*;
use std::io;
use std::sync::Arc;
use tracing::field::Empty;

/// What was written.
#[derive(Clone, Default)]
struct Written(Arc<Mutex<Vec<u8>>>);

impl Written {
    fn lines(&self) -> Vec<String> {
        let bytes = std::mem::take(&mut *self.0.lock().expect("not poisoned"));
        String::from_utf8(bytes).expect("text").lines().map(|line| line.trim().to_owned()).collect()
    }
}

impl io::Write for Written {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().expect("not poisoned").extend(bytes);
        Ok(bytes.len())
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn denied(address: &str) {
    tracing::info!(peer = %address, path = "/list", "a request was denied");
}

#[tokio::test(start_paused = true)]
async fn a_line_that_a_peer_causes_is_written_a_few_times_and_then_counted_and_no_other_line_is_touched() {
    let (written, counted) = (Written::default(), &*Box::leak(Box::new(Counted::new())));
    let sink = written.clone();
    let lines = tracing_subscriber::fmt().with_ansi(false).without_time().with_target(false);
    let lines = lines.with_writer(move || sink.clone()).finish().with(Throttle(counted));
    let _guard = tracing::subscriber::set_default(lines);
    (0..1_000).for_each(|_| denied("10.0.0.7"));
    denied("10.0.0.8");
    let first = r"INFO a request was denied peer=10.0.0.7 path=".to_owned() + "\"/list\"";
    let mut expected = vec![first.clone(); limits::FLOOD_LINES as usize];
    expected.push(first.replace(".7", ".8"));
    assert_eq!(written.lines(), expected);
    (0..100).for_each(|_| tracing::warn!(robot_id = "r1", "a robot stands"));
    assert_eq!(written.lines().len(), 100);
    for robot_id in ["r1", "r2"] {
        (0..10).for_each(|_| tracing::info!(peer = Empty, robot_id, "session begun"));
        let begun = format!("INFO session begun robot_id=\"{robot_id}\"");
        assert_eq!(written.lines(), vec![begun; limits::FLOOD_LINES as usize], "each robot for itself");
    }
    tokio::time::advance(Duration::from_millis(limits::FLOOD_COUNTED_EVERY.as_ms())).await;
    counted.counts().iter().for_each(log_count);
    let told = |times: u64, line: &str, of: &str| {
        format!("INFO more of these in the last minute times={times} line=\"{line}\" of=\"{of}\"")
    };
    let session = 10 - u64::from(limits::FLOOD_LINES);
    let expected = [
        told(1_000 - u64::from(limits::FLOOD_LINES), "a request was denied", "10.0.0.7"),
        told(session, "session begun", "r1"),
        told(session, "session begun", "r2"),
    ];
    assert_eq!(written.lines(), expected);
}
