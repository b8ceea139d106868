//! All chains read whole and held against their hashes, against each other, and against what somebody noted down.
//!
//! Invariant: heads are read before rows, so that every row that is asked for was there; a row that an anchor quotes is looked up where it
//! should be, in the chain of the other service.

use super::pages::encode_head;
use super::{AuditService, page, unavailable};
use midshift_core::audit::{AuditRow, Broken, Chain, Ends, Head, Kind, Mark, Verified, id_of};
use midshift_core::reason::{Refusal, Violations};
use midshift_core::rows::{Key, Row, Table};
use midshift_proto::identity::v1;
use midshift_store::{Cursor, Query};
use std::collections::BTreeMap;
use tokio::sync::mpsc;
use tonic::Status;

/// Rows between two messages of how far it is.
const TOLD_EVERY: u64 = 10_000;

type Sender = mpsc::Sender<Result<v1::VerifyAuditResponse, Status>>;
type Verdicts = BTreeMap<&'static str, Result<Verified, Broken>>;

/// What the caller noted down, as rows to be found.
///
/// # Errors
/// What cannot be a row of a chain.
pub(super) fn noted(r: &v1::VerifyAuditRequest) -> Result<Vec<Mark>, Refusal> {
    let mut bad = Violations::default();
    if r.heads.len() > midshift_core::limits::PAGE_MAX {
        bad.add("heads", "at most 1000");
    }
    let mut noted = Vec::new();
    for (i, head) in r.heads.iter().enumerate() {
        let is_known = Table::audit_named(&head.service).is_some();
        match Mark::parse(&format!("{}:{}:{}", head.service, head.n, head.hash)) {
            Some(mark) if is_known => noted.push(mark),
            Some(_) => bad.add(format!("heads[{i}].service"), "has no audit"),
            None => {
                bad.add(format!("heads[{i}]"), "needs a service, a number, and 64 hexadecimal digits in lower case")
            }
        }
    }
    bad.finish()?;
    Ok(noted)
}

impl AuditService {
    /// Verifies everything and says how far it is.
    pub(super) async fn verify(&self, noted: Vec<Mark>, sender: &Sender) -> Result<(), Refusal> {
        let heads = self.store.audit_heads().await.map_err(unavailable)?;
        let own = heads.iter().map(|(writer, head)| Mark {
            service: writer.as_str().to_owned(),
            head: head.clone(),
            by: "the store's note of its newest row".to_owned(),
            at_unix_ms: None,
        });
        let marks: Vec<Mark> = own.chain(noted).collect();
        let (mut verdicts, mut broken_quotes, mut read) = (Verdicts::new(), BTreeMap::new(), 0);
        for (writer, table) in Table::audits() {
            let name = writer.as_str();
            let mut chain = Chain::new(name, marks.iter().cloned(), self.clock.now().wall);
            let verdict = loop {
                match self.stretch(&mut chain, *table, &mut read, &mut broken_quotes).await? {
                    Ok(true) => {}
                    Ok(false) => break chain.finish(),
                    Err(broken) => break Err(broken),
                }
                if read % TOLD_EVERY < midshift_core::limits::PAGE_MAX as u64 {
                    // Who does not listen any more is noticed at the end.
                    let _ = sender.send(Ok(v1::VerifyAuditResponse { rows_read: read, verdicts: Vec::new() })).await;
                }
            };
            verdicts.insert(name, verdict);
        }
        let verdicts = verdicts.into_iter().map(|(name, verdict)| {
            let quoted = broken_quotes.remove(name).map_or(Ok(()), Err);
            encode(name, verdict.and_then(|verified| quoted.map(|()| verified)))
        });
        let last = v1::VerifyAuditResponse { rows_read: read, verdicts: verdicts.collect() };
        drop(sender.send(Ok(last)).await);
        Ok(())
    }

    /// Takes the next rows of a chain. Inner: whether there were any, or what is wrong with it.
    async fn stretch(
        &self,
        chain: &mut Chain,
        table: Table,
        read: &mut u64,
        broken_quotes: &mut BTreeMap<String, Broken>,
    ) -> Result<Result<bool, Broken>, Refusal> {
        let rows = page(&*self.store, table, place(chain)).await?;
        let mut quoted = Vec::new();
        for row in &rows {
            *read += 1;
            match chain.take_row(row) {
                Ok(row) => quoted.extend(Mark::quoted(&row)),
                Err(broken) => return Ok(Err(broken)),
            }
        }
        for (service, broken) in self.hold(&quoted).await? {
            broken_quotes.entry(service).or_insert(broken);
        }
        Ok(Ok(!rows.is_empty()))
    }

    /// Whether quoted rows are where they should be.
    async fn hold(&self, quoted: &[Mark]) -> Result<Vec<(String, Broken)>, Refusal> {
        let mut broken = Vec::new();
        for marks in quoted.chunks(midshift_core::limits::PAGE_MAX) {
            let key = |mark: &Mark| Some(Key::new(Table::audit_named(&mark.service)?, id_of(mark.head.n)));
            let rows = self.store.get(marks.iter().filter_map(key).collect()).await.map_err(unavailable)?;
            let bodies: BTreeMap<&Key, &str> = rows.iter().map(|row| (&row.key, &*row.body)).collect();
            for mark in marks {
                let Some(key) = key(mark) else { continue };
                let body = bodies.get(&key).copied();
                let ends = if body.is_some() { Ends::default() } else { self.ends(key.table).await? };
                if let Err(found) = mark.hold(body, ends) {
                    broken.push((mark.service.clone(), found));
                }
            }
        }
        Ok(broken)
    }

    /// Where a chain begins and ends now.
    async fn ends(&self, table: Table) -> Result<Ends, Refusal> {
        let one = async |query: Query| {
            let rows = self.store.list(Query { limit: 1, ..query }).await;
            rows.map(|mut rows| rows.pop()).map_err(unavailable)
        };
        let newest = || Query { newest_first: true, ..Query::all(table) };
        let n = |row: Option<Row>| row.and_then(|row| row.index.order).unwrap_or(0).max(0).cast_unsigned();
        let at = |row: Row| AuditRow::read(&row.body).map(|row| row.at_unix_ms);
        Ok(Ends {
            first: n(one(Query::all(table)).await?),
            last: n(one(newest()).await?),
            cut_unix_ms: one(newest().in_states([Kind::Cut.number()])).await?.and_then(at),
            now_unix_ms: self.clock.now().wall.0,
        })
    }
}

/// Where in its table a chain goes on.
fn place(chain: &Chain) -> Option<Cursor> {
    let Head { n, .. } = chain.head();
    (*n > 0).then(|| Cursor { order: n.cast_signed(), id: id_of(*n).into() })
}

fn encode(service: &str, verdict: Result<Verified, Broken>) -> v1::AuditVerdict {
    let service = service.to_owned();
    match verdict {
        Ok(Verified { first, rows, head }) => {
            let head = Some(encode_head(&service, &head));
            v1::AuditVerdict { service, rows, first, head, broken: None }
        }
        Err(broken) => {
            let (what, n, text) = (broken.word().to_owned(), broken.row(), broken.to_string());
            let broken = Some(v1::AuditBreak { what, n, text });
            v1::AuditVerdict { service, broken, ..v1::AuditVerdict::default() }
        }
    }
}
