//! Lines of a run, beside what the test harness says.

/// Prints one line.
pub fn print_line(text: &str) {
    use std::io::Write;
    let _ = writeln!(std::io::stderr(), "{text}");
}
