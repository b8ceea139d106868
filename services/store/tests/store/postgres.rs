//! What only PostgreSQL has: several processes on one database, its failures, and how they hear of each other.
