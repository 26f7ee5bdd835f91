#!/bin/sh
# Certificates for trying it out: an authority, a daemon, a controller. `sh certificates.sh [DIRECTORY]`
# For a plant, use the authority that you already have.
set -eu
mkdir -p "${1:-certificates}"
cd "${1:-certificates}"
new="-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes"
openssl req -x509 $new -days 365 -subj "/CN=drivelink authority" -keyout ca.key -out ca.pem
for name in daemon controller; do
    openssl req $new -subj "/CN=$name" -addext "subjectAltName=DNS:localhost,IP:127.0.0.1,DNS:$name" \
        -keyout "$name.key" -out "$name.csr"
    openssl x509 -req -in "$name.csr" -CA ca.pem -CAkey ca.key -CAcreateserial -days 365 \
        -copy_extensions copy -out "$name.pem"
    rm "$name.csr"
done
