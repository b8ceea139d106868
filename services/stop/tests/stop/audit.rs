//! The audit that a running service writes, and what is found when somebody changes it.

use crate::harness::{Folder, Server, eventually, fleet, id_of};
use midshift_stop::audit::Broken;
use midshift_stop::verify;
use std::fs;

#[tokio::test]
async fn what_was_engaged_and_reset_is_recorded_before_the_answer_and_every_change_of_it_is_found() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let path = folder.path().join("audit.jsonl");
    let mut ids = Vec::new();
    for _ in 0..3 {
        let id = id_of(&server.engage(fleet()).await.unwrap());
        let text = fs::read_to_string(&path).unwrap();
        assert!(text.contains("\"ENGAGED\"") && text.contains(&id), "{text}");
        ids.push(id);
    }
    server.reset(&ids[0]).await;
    assert!(fs::read_to_string(&path).unwrap().contains("\"RESET\""));
    // The latch hears of the last record a moment after the answer.
    let known =
        || midshift_latch::read::<serde_json::Value>(&folder.path().join("latch")).unwrap().1["audit"]["n"].clone();
    eventually(async || (known() == 5).then_some(())).await;
    assert_eq!(verify(&folder.path()).unwrap().records, 5, "one is of the start");
    server.kill();

    let good = fs::read_to_string(&path).unwrap();
    let lines: Vec<&str> = good.lines().collect();
    let broken = |lines: &[&str]| {
        fs::write(&path, lines.iter().map(|l| format!("{l}\n")).collect::<String>()).unwrap();
        verify(&folder.path()).expect_err("it was changed")
    };
    let altered = lines[1].replace("drill", "fire!");
    assert!(matches!(broken(&[lines[0], &altered, lines[2], lines[3], lines[4]]), Broken::Altered { line: 2 }));
    assert!(matches!(broken(&[lines[0], lines[2], lines[3], lines[4]]), Broken::Order { line: 2, .. }));
    assert!(matches!(broken(&[lines[0], lines[1], lines[3], lines[2], lines[4]]), Broken::Order { line: 3, .. }));
    assert!(matches!(broken(&lines[..4]), Broken::Truncated { last: 4, known: 5 }));
    fs::write(&path, &good).unwrap();
    let server = Server::start(&folder.path()).await;
    server.engage(fleet()).await.unwrap();
    assert_eq!(verify(&folder.path()).unwrap().records, 7, "the chain goes on after a kill");
}
