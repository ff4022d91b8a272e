#include "proto/connection_probe.h"

#include <fcntl.h>
#include <openssl/bio.h>
#include <openssl/err.h>
#include <openssl/pem.h>
#include <openssl/ssl.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <memory>
#include <string_view>

#include "core/base/blob.h"
#include "core/base/posix_file.h"
#include "proto/resolve.h"

namespace farpoint {

namespace {

using std::chrono::milliseconds;
using Clock = std::chrono::steady_clock;

// RFC 9113: the client's preface and an empty SETTINGS frame; a server answers with a SETTINGS
// frame.
constexpr std::string_view kHello("PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\4\0\0\0\0\0", 33);
constexpr size_t kFrameHeadBytes = 9;
constexpr char kSettingsFrame = 4;
constexpr size_t kMaxTokenBytes = 4096;

struct SslContextDeleter {
  void operator()(SSL_CTX* context) const { SSL_CTX_free(context); }
};
struct SslDeleter {
  void operator()(SSL* ssl) const { SSL_free(ssl); }
};
struct BioDeleter {
  void operator()(BIO* bio) const { BIO_free_all(bio); }
};
using SslContextPtr = std::unique_ptr<SSL_CTX, SslContextDeleter>;
using SslPtr = std::unique_ptr<SSL, SslDeleter>;
using BioPtr = std::unique_ptr<BIO, BioDeleter>;

int LeftMs(Clock::time_point end) {
  const auto left = std::chrono::ceil<milliseconds>(end - Clock::now()).count();
  return static_cast<int>(std::clamp<int64_t>(left, 0, 1'000'000));
}

// False when the time is over.
bool WaitFor(int fd, short what, Clock::time_point end) {
  pollfd one{.fd = fd, .events = what, .revents = 0};
  for (;;) {
    const int ready = ::poll(&one, 1, LeftMs(end));
    if (ready > 0) return true;
    if (ready == 0 || errno != EINTR) return false;
  }
}

absl::Status NoConnection(const std::string& address, int error) {
  const HostPort parts = SplitHostPort(address);
  switch (error) {
    case ECONNREFUSED:
      return absl::UnavailableError("nobody listens on port " + parts.port + " of " + parts.host +
                                    "; start farpoint-server there, or correct the port");
    case ETIMEDOUT:
      return absl::UnavailableError(
          address +
          " does not answer; is the address right, the machine on, and does "
          "no firewall drop port " +
          parts.port + "?");
    case ENETUNREACH:
    case EHOSTUNREACH:
    case EADDRNOTAVAIL:
    case EINVAL:
    case EACCES:
      return absl::UnavailableError("there is no route to " + parts.host +
                                    "; check the address and this machine's network");
    default:
      return absl::UnavailableError("cannot connect to " + address + ": " + std::strerror(error) +
                                    "; check the address and this machine's network");
  }
}

absl::StatusOr<Descriptor> Connect(const std::string& address, Clock::time_point end) {
  const absl::StatusOr<AddressList> list = Resolve(address);
  if (!list.ok()) {
    return absl::UnavailableError(std::string(list.status().message()) +
                                  "; check its spelling, /etc/hosts and the name server");
  }
  int error = ECONNREFUSED;
  for (const addrinfo* at = list->get(); at != nullptr; at = at->ai_next) {
    Descriptor fd(::socket(at->ai_family, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0));
    if (!fd.valid()) {
      error = errno;
      continue;
    }
    if (::connect(fd.get(), at->ai_addr, at->ai_addrlen) == 0) return fd;
    error = errno;
    if (error != EINPROGRESS) continue;
    if (!WaitFor(fd.get(), POLLOUT, end)) {
      error = ETIMEDOUT;
      continue;
    }
    socklen_t size = sizeof(error);
    ::getsockopt(fd.get(), SOL_SOCKET, SO_ERROR, &error, &size);
    if (error == 0) return fd;
  }
  return NoConnection(address, error);
}

// What a server's first bytes say of it.
enum class Greeting { kHttp2, kHttp1, kTls, kClosed, kSilent, kOther };

Greeting Classify(std::string_view bytes, bool closed) {
  if (bytes.size() >= kFrameHeadBytes && bytes[3] == kSettingsFrame && bytes[0] == 0) {
    return Greeting::kHttp2;
  }
  if (bytes.starts_with("HTTP/1")) return Greeting::kHttp1;
  if (bytes.size() >= 2 && (bytes[0] == 0x15 || bytes[0] == 0x16) && bytes[1] == 3) {
    return Greeting::kTls;
  }
  if (bytes.empty()) return closed ? Greeting::kClosed : Greeting::kSilent;
  return Greeting::kOther;
}

Greeting GreetInTheClear(int fd, Clock::time_point end) {
  (void)::send(fd, kHello.data(), kHello.size(), MSG_NOSIGNAL);
  std::string bytes;
  while (bytes.size() < kFrameHeadBytes && WaitFor(fd, POLLIN, end)) {
    char part[64];
    const ssize_t size = ::recv(fd, part, sizeof(part), 0);
    if (size < 0 && (errno == EINTR || errno == EAGAIN)) continue;
    if (size <= 0) return Classify(bytes, true);
    bytes.append(part, static_cast<size_t>(size));
  }
  return Classify(bytes, false);
}

absl::Status NotOurs(const std::string& address, Greeting greeting) {
  switch (greeting) {
    case Greeting::kHttp2:
      return absl::OkStatus();
    case Greeting::kHttp1:
      return absl::FailedPreconditionError(
          "at " + address + " an HTTP server answers, not a coordinator; correct the port");
    case Greeting::kTls:
      return absl::FailedPreconditionError(
          address + " wants TLS; give --certs DIR, or --tls-ca and --token-file");
    case Greeting::kClosed:
      return absl::UnavailableError(
          address +
          " closes the connection at once; is it a coordinator, and has it "
          "room for more connections?");
    case Greeting::kSilent:
      return absl::UnavailableError(
          address +
          " takes connections but says nothing; the process there hangs, or "
          "is no coordinator");
    case Greeting::kOther:
      break;
  }
  return absl::FailedPreconditionError(
      "at " + address + " something else than a coordinator answers; correct the port");
}

BioPtr Reader(const std::string& text) {
  return BioPtr(BIO_new_mem_buf(text.data(), static_cast<int>(text.size())));
}

absl::StatusOr<SslContextPtr> NewContext(const TlsMaterial& tls) {
  SslContextPtr context(SSL_CTX_new(TLS_client_method()));
  if (!context) return absl::InternalError("the TLS library does not start");
  SSL_CTX_set_min_proto_version(context.get(), TLS1_2_VERSION);
  // Looked at afterwards, by who can say what is wrong with it.
  SSL_CTX_set_verify(context.get(), SSL_VERIFY_NONE, nullptr);
  static constexpr unsigned char kH2[] = {2, 'h', '2'};
  SSL_CTX_set_alpn_protos(context.get(), kH2, sizeof(kH2));
  if (tls.certificate.empty()) return context;
  const BioPtr certificate_text = Reader(tls.certificate), key_text = Reader(tls.key);
  X509* certificate = PEM_read_bio_X509(certificate_text.get(), nullptr, nullptr, nullptr);
  EVP_PKEY* key = PEM_read_bio_PrivateKey(key_text.get(), nullptr, nullptr, nullptr);
  const bool used = certificate != nullptr && key != nullptr &&
                    SSL_CTX_use_certificate(context.get(), certificate) == 1 &&
                    SSL_CTX_use_PrivateKey(context.get(), key) == 1;
  X509_free(certificate);
  EVP_PKEY_free(key);
  if (!used) return absl::FailedPreconditionError("certificate and key do not belong together");
  return context;
}

std::string PemOf(X509* certificate) {
  const BioPtr bio(BIO_new(BIO_s_mem()));
  if (!bio || PEM_write_bio_X509(bio.get(), certificate) != 1) return "";
  const char* data = nullptr;
  const long size = BIO_get_mem_data(bio.get(), &data);
  return size <= 0 ? std::string() : std::string(data, static_cast<size_t>(size));
}

// The server's certificate and what it sent with it.
std::string PeerChain(SSL* ssl) {
  std::string pem;
  STACK_OF(X509)* const chain = SSL_get_peer_cert_chain(ssl);
  for (int i = 0; chain != nullptr && i < std::min(sk_X509_num(chain), 8); ++i) {
    pem += PemOf(sk_X509_value(chain, i));
  }
  return pem;
}

// The alert by which the peer refused our certificate, if that is what happened.
std::optional<std::string> RefusedBecause(unsigned long error) {
  switch (ERR_GET_REASON(error)) {
    case SSL_R_TLSV1_ALERT_UNKNOWN_CA:
      return "it does not know the authority that issued it";
    case SSL_R_SSLV3_ALERT_CERTIFICATE_EXPIRED:
      return "it has expired";
    case SSL_R_SSLV3_ALERT_CERTIFICATE_REVOKED:
      return "it was revoked";
    case SSL_R_SSLV3_ALERT_BAD_CERTIFICATE:
    case SSL_R_SSLV3_ALERT_CERTIFICATE_UNKNOWN:
    case SSL_R_SSLV3_ALERT_UNSUPPORTED_CERTIFICATE:
    case SSL_R_TLSV1_ALERT_ACCESS_DENIED:
      return "it is not one that it takes";
    case SSL_R_TLSV13_ALERT_CERTIFICATE_REQUIRED:
      return "there is none";
    default:
      return std::nullopt;
  }
}

class TlsProbe {
 public:
  TlsProbe(const std::string& address, int fd, Clock::time_point end)
      : address_(address), fd_(fd), end_(end) {}

  // kAborted: no TLS there, the caller finds out what it is.
  absl::Status Run(const TlsMaterial& tls) {
    FP_ASSIGN_OR_RETURN(const SslContextPtr context, NewContext(tls));
    const SslPtr ssl(SSL_new(context.get()));
    const std::string host = SplitHostPort(address_).host;
    if (!ssl || SSL_set_fd(ssl.get(), fd_) != 1) {
      return absl::InternalError("the TLS library does not start");
    }
    SSL_set_tlsext_host_name(ssl.get(), host.c_str());
    bool said_tls = false;
    while (true) {
      ERR_clear_error();
      const int done = SSL_connect(ssl.get());
      if (done == 1) break;
      said_tls = said_tls || SSL_get_peer_cert_chain(ssl.get()) != nullptr;
      FP_RETURN_IF_ERROR(Wait(ssl.get(), done, said_tls));
    }
    const std::string chain = PeerChain(ssl.get());
    FP_RETURN_IF_ERROR(Annotate(CheckIssued(chain, tls.ca, /*server=*/true, NowUnixS()),
                                "the coordinator at " + address_));
    FP_RETURN_IF_ERROR(Annotate(CheckHost(chain, host), "the coordinator at " + address_));
    return Greet(ssl.get());
  }

 private:
  // After a call that did not finish: OK to try again.
  absl::Status Wait(SSL* ssl, int done, bool said_tls) {
    switch (SSL_get_error(ssl, done)) {
      case SSL_ERROR_WANT_READ:
        if (WaitFor(fd_, POLLIN, end_)) return absl::OkStatus();
        return NotOurs(address_, Greeting::kSilent);
      case SSL_ERROR_WANT_WRITE:
        if (WaitFor(fd_, POLLOUT, end_)) return absl::OkStatus();
        return NotOurs(address_, Greeting::kSilent);
      case SSL_ERROR_SSL: {
        const unsigned long error = ERR_get_error();
        if (const auto why = RefusedBecause(error)) {
          return absl::UnauthenticatedError("the coordinator at " + address_ +
                                            " refuses this side's certificate: " + *why +
                                            "; its log says more");
        }
        if (!said_tls) return absl::AbortedError("no TLS");
        char text[256];
        ERR_error_string_n(error, text, sizeof(text));
        return absl::FailedPreconditionError("TLS with " + address_ + " fails: " + text);
      }
      default:
        if (!said_tls) return absl::AbortedError("no TLS");
        return absl::UnavailableError(address_ + " ended the TLS connection; its log says why");
    }
  }

  absl::Status Greet(SSL* ssl) {
    while (true) {
      ERR_clear_error();
      const int done = SSL_write(ssl, kHello.data(), static_cast<int>(kHello.size()));
      if (done > 0) break;
      FP_RETURN_IF_ERROR(Wait(ssl, done, true));
    }
    std::string bytes;
    while (bytes.size() < kFrameHeadBytes) {
      char part[64];
      ERR_clear_error();
      const int size = SSL_read(ssl, part, sizeof(part));
      if (size > 0) {
        bytes.append(part, static_cast<size_t>(size));
        continue;
      }
      if (SSL_get_error(ssl, size) == SSL_ERROR_ZERO_RETURN) {
        return NotOurs(address_, Classify(bytes, true));
      }
      FP_RETURN_IF_ERROR(Wait(ssl, size, true));
    }
    return NotOurs(address_, Classify(bytes, false));
  }

  const std::string& address_;
  const int fd_;
  const Clock::time_point end_;
};

}  // namespace

absl::StatusOr<std::string> ReadTokenFile(const std::string& path) {
  struct stat facts {};
  if (::stat(path.c_str(), &facts) != 0) return FileError("cannot read", path, errno);
  if ((facts.st_mode & 077U) != 0) {
    return absl::FailedPreconditionError("'" + path +
                                         "': this token can be read or changed by others than its "
                                         "owner; chmod 600 " +
                                         path);
  }
  FP_ASSIGN_OR_RETURN(const Blob blob, ReadFile(path, kMaxTokenBytes));
  std::string_view text(reinterpret_cast<const char*>(blob.bytes().data()), blob.size());
  text = text.substr(0, text.find_first_of("\r\n"));
  if (!LooksLikeToken(text)) {
    return absl::FailedPreconditionError(
        "'" + path +
        "': holds no token in its first line; farpoint certs token "
        "makes one");
  }
  return std::string(text);
}

absl::Status ProbeConnection(const std::string& address, const ChannelSecurity& security,
                             milliseconds timeout) {
  const Clock::time_point end = Clock::now() + timeout;
  FP_ASSIGN_OR_RETURN(const Descriptor fd, Connect(address, end));
  if (!security.tls) return NotOurs(address, GreetInTheClear(fd.get(), end));
  const absl::Status status = TlsProbe(address, fd.get(), end).Run(*security.tls);
  if (!absl::IsAborted(status)) return status;
  FP_ASSIGN_OR_RETURN(const Descriptor plain, Connect(address, end));
  const Greeting greeting = GreetInTheClear(plain.get(), end);
  if (greeting == Greeting::kHttp2) {
    return absl::FailedPreconditionError("the coordinator at " + address +
                                         " speaks no TLS; start it with --certs DIR, or leave the "
                                         "certificates out if it is on this machine");
  }
  return NotOurs(address, greeting == Greeting::kTls ? Greeting::kOther : greeting);
}

}  // namespace farpoint
