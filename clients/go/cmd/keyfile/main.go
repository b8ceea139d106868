// Signs the text with a key file of `midshift bundle keygen`; prints the signature in hexadecimal digits. Go's own library alone.
//
//	keyfile KEY.pem TEXT
package main

import (
	"crypto/ed25519"
	"crypto/x509"
	"encoding/pem"
	"errors"
	"fmt"
	"os"
)

func main() {
	signature, err := sign(os.Args[1], os.Args[2])
	if err != nil {
		fmt.Fprintln(os.Stderr, err)
		os.Exit(1)
	}
	fmt.Printf("%x\n", signature)
}

func sign(file, text string) ([]byte, error) {
	content, err := os.ReadFile(file)
	if err != nil {
		return nil, err
	}
	block, _ := pem.Decode(content)
	if block == nil {
		return nil, errors.New("no PEM")
	}
	key, err := x509.ParsePKCS8PrivateKey(block.Bytes)
	if err != nil {
		return nil, err
	}
	secret, ok := key.(ed25519.PrivateKey)
	if !ok {
		return nil, errors.New("no ed25519 key")
	}
	return ed25519.Sign(secret, []byte(text)), nil
}
