#!/bin/sh
# Certificates for trying it out: an authority, a daemon, a controller. `sh certificates.sh [DIRECTORY]`
# The daemon's may only serve and the controller's may only connect (extended key usage); each is good for its
# own name, so that none can play the other. For a plant, use the authority that you already have.
set -eu
umask 077
mkdir -p "${1:-certificates}"
cd "${1:-certificates}"
new="-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes"
openssl req -x509 $new -days 365 -subj "/CN=drivelink authority" -keyout ca.key -out ca.pem \
    -addext "basicConstraints=critical,CA:TRUE" -addext "keyUsage=critical,keyCertSign,cRLSign"

# issue NAME USAGE SUBJECT_ALT_NAMES
issue() {
    openssl req $new -subj "/CN=$1" -keyout "$1.key" -out "$1.csr" \
        -addext "basicConstraints=critical,CA:FALSE" -addext "keyUsage=critical,digitalSignature" \
        -addext "extendedKeyUsage=critical,$2" -addext "subjectAltName=$3"
    openssl x509 -req -in "$1.csr" -CA ca.pem -CAkey ca.key -CAcreateserial -days 365 \
        -copy_extensions copy -out "$1.pem"
    rm "$1.csr"
}
issue daemon serverAuth DNS:daemon,DNS:localhost
issue controller clientAuth DNS:controller
