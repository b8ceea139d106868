//! Exports the audit as lines: what it is of and where its chains end, then each row byte for byte as stored.
//!
//! Invariant: whoever takes the audit away stands in it: the row of an export is written before the export begins, and is in it.

use super::{AuditService, page, unavailable};
use midshift_core::audit::{Export, Note};
use midshift_core::identity::Actor;
use midshift_core::item::Item;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rows::{Table, Writer};
use midshift_proto::identity::v1;
use midshift_store::Cursor;
use tokio::sync::mpsc;
use tonic::Status;

/// Bytes of lines in one message, about.
const MESSAGE_BYTES: usize = 64 * 1024;

type Sender = mpsc::Sender<Result<v1::ExportAuditResponse, Status>>;

impl AuditService {
    /// Sends all of it, up to the rows that are the newest now.
    pub(super) async fn export(&self, by: &Actor, sender: &Sender) -> Result<(), Refusal> {
        self.note_export(by).await?;
        let heads = self.store.audit_heads().await.map_err(unavailable)?;
        let first = Export {
            format: Export::FORMAT.to_owned(),
            site: self.store.site_id().to_string(),
            store: self.store.id().to_string(),
            at_unix_ms: self.clock.now().wall.0,
            heads: heads.iter().map(|(writer, head)| (writer.as_str().to_owned(), head.clone())).collect(),
        };
        let first = serde_json::to_string(&first).map_err(|_| Refusal::new(Kind::Internal, Code::Internal))?;
        let (mut bytes, mut lines) = (first.len(), vec![first]);
        // In the order in which the first line names them.
        let mut chains: Vec<_> = heads.iter().collect();
        chains.sort_by_key(|(writer, _)| writer.as_str());
        for (writer, head) in chains {
            let Some(table) = Table::audit_of(*writer) else { continue };
            let mut after = None;
            'rows: loop {
                let rows = page(&*self.store, table, after).await?;
                let Some(last) = rows.last() else { break };
                after = Some(Cursor::of_row(last));
                for row in rows {
                    if row.index.order.is_some_and(|n| n.cast_unsigned() > head.n) {
                        break 'rows;
                    }
                    bytes += row.body.len();
                    lines.push(row.body.to_string());
                    if bytes >= MESSAGE_BYTES {
                        send(sender, std::mem::take(&mut lines)).await?;
                        bytes = 0;
                    }
                }
            }
        }
        if lines.is_empty() { Ok(()) } else { send(sender, lines).await }
    }

    async fn note_export(&self, by: &Actor) -> Result<(), Refusal> {
        let mut item = Item::new(Writer::Identity, by);
        item.audit(Note::new("audit.export"));
        match self.store.commit(vec![item]).await.pop() {
            Some(Err(error)) => {
                tracing::warn!(%error, "an export of the audit was not begun: its row cannot be written");
                Err(Refusal::new(Kind::Unavailable, Code::StoreUnavailable))
            }
            _ => Ok(()),
        }
    }
}

async fn send(sender: &Sender, lines: Vec<String>) -> Result<(), Refusal> {
    // Nobody reads any more: nothing is left to be done.
    let gone = |_| Refusal::new(Kind::Unavailable, Code::ShuttingDown);
    sender.send(Ok(v1::ExportAuditResponse { lines })).await.map_err(gone)
}
