//! Whose rows a database holds: the site, and the id of the store.

use crate::{OpenError, StoreId, sql};
use midshift_core::ids::SiteId;
use midshift_core::time::Utc;
use sqlx::{PgConnection, Row};
use std::sync::Arc;

/// Reads the store's identity, or makes one: a new store gets a random id and numbers from `created` on.
pub(super) async fn identify(
    connection: &mut PgConnection,
    site_id: &SiteId,
    created: Utc,
) -> Result<StoreId, OpenError> {
    let failed = |source| OpenError::Sql { doing: "reading the store's identity", source };
    if sqlx::query(sql::IDENTITY).fetch_optional(&mut *connection).await.map_err(failed)?.is_none() {
        sqlx::query(sql::IDENTIFY)
            .bind(site_id.as_str())
            .bind(&*StoreId::fresh().0)
            .bind(created.0.max(0))
            .execute(&mut *connection)
            .await
            .map_err(failed)?;
    }
    let row = sqlx::query(sql::IDENTITY).fetch_one(connection).await.map_err(failed)?;
    let found: String = row.try_get(0).map_err(failed)?;
    if found != site_id.as_str() {
        return Err(OpenError::OtherSite { found, asked: site_id.clone() });
    }
    let store_id: String = row.try_get(1).map_err(failed)?;
    Ok(StoreId(Arc::from(store_id)))
}
