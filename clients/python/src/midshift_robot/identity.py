"""Who a machine is at its site: the chapter "Who it is" of docs/robot-protocol.md as a program."""

import argparse
import os
import sys
import time

import grpc
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from midshift.identity.v1 import enrolment_service_pb2 as enrolment
from midshift.identity.v1 import enrolment_service_pb2_grpc


class Identity:
    """Who this machine is at its site: a key that never leaves it, and a certificate of that key for some days."""

    CERTIFICATE_LIFE_S = 7 * 24 * 3600
    # Every server of a site is called so in its certificate.
    OPTIONS = (("grpc.enable_retries", 0), ("grpc.use_local_subchannel_pool", 1), ("grpc.ssl_target_name_override", "midshift"))

    def __init__(self, args: argparse.Namespace, memory) -> None:
        self.server, self.robot_id, self.memory = args.server, args.robot_id, memory
        if args.ca and not memory["identity"]:
            line = os.environ.get("MIDSHIFT_ENROLL")
            if not line:
                sys.exit(f"not enrolled: run `midshift robot enroll {args.robot_id}` and give its secret with MIDSHIFT_ENROLL")
            self._enrol(args.ca.read_bytes(), line)

    @property
    def is_enrolled(self) -> bool:
        return bool(self.memory["identity"])

    def channel(self, server: str) -> grpc.Channel:
        """A new connection, on which this machine shows who it is; in plain text where the site has no login."""
        mine = self.memory["identity"]
        if not mine:
            return grpc.insecure_channel(server, self.OPTIONS)
        if time.time() > mine["expires_unix_s"] - self.CERTIFICATE_LIFE_S / 2:
            self._renew(mine)
        return grpc.secure_channel(server, self._shown(self.memory["identity"]), self.OPTIONS)

    @staticmethod
    def _shown(mine: dict) -> grpc.ChannelCredentials:
        return grpc.ssl_channel_credentials(*(mine[name].encode() for name in ("authority_pem", "key_pem", "certificate_pem")))

    @staticmethod
    def _request(key: ec.EllipticCurvePrivateKey) -> str:
        """A signing request. Names are the site's to give."""
        request = x509.CertificateSigningRequestBuilder(x509.Name([])).sign(key, hashes.SHA256())
        return request.public_bytes(serialization.Encoding.PEM).decode()

    def _enrol(self, authority_pem: bytes, line: str) -> None:
        secret, pin = line.rsplit(".", 1)
        spki = (serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo)
        digest = hashes.Hash(hashes.SHA256())
        digest.update(x509.load_pem_x509_certificate(authority_pem).public_key().public_bytes(*spki))
        if digest.finalize().hex() != pin:
            sys.exit("the file of --ca is not the root of the site that the secret of MIDSHIFT_ENROLL came from")
        key = ec.generate_private_key(ec.SECP256R1())
        pem = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
        asked = enrolment.EnrolRequest(robot_id=self.robot_id, secret=secret, request_pem=self._request(key))
        with grpc.secure_channel(self.server, grpc.ssl_channel_credentials(authority_pem), self.OPTIONS) as channel:
            answer = enrolment_service_pb2_grpc.EnrolmentServiceStub(channel).Enrol(asked, timeout=10)
        self._keep(key.private_bytes(*pem).decode(), answer)

    def _renew(self, mine: dict) -> None:
        key = serialization.load_pem_private_key(mine["key_pem"].encode(), password=None)
        asked = enrolment.RenewCertificateRequest(robot_id=self.robot_id, request_pem=self._request(key))
        try:
            with grpc.secure_channel(self.server, self._shown(mine), self.OPTIONS) as channel:
                stub = enrolment_service_pb2_grpc.EnrolmentServiceStub(channel)
                self._keep(mine["key_pem"], stub.RenewCertificate(asked, timeout=10))
        except grpc.RpcError as error:
            # The old one is good for days.
            print("not renewed:", error.code().name, error.details(), flush=True)

    def _keep(self, key_pem: str, answer) -> None:
        self.memory["identity"] = {
            "key_pem": key_pem,
            "certificate_pem": answer.certificate_pem,
            "authority_pem": answer.authority_pem,
            "expires_unix_s": answer.expire_time.seconds,
        }
        self.memory.save()
