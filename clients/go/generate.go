// Package clients holds the Go client of midshift: package midshift beside this file, and what buf makes from the .proto files in gen.
//
// Nothing generated is committed: `go generate .` makes it, with buf on the PATH and the plugins that go.mod pins.
package clients

//go:generate buf generate
//go:generate cp ../../proto/service_config.json midshift/service_config.json
