package midshift

import (
	"strings"
	"testing"
)

func TestATokenGoesToNobodyInPlainText(t *testing.T) {
	if _, err := New("127.0.0.1:1", SignIn{Token: "mst.a.b"}); err == nil || !strings.Contains(err.Error(), "whose root is not known") {
		t.Fatal(err)
	}
}
