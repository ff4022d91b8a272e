#include "proto/certificate.h"

#include <arpa/inet.h>
#include <openssl/bio.h>
#include <openssl/bn.h>
#include <openssl/ec.h>
#include <openssl/err.h>
#include <openssl/evp.h>
#include <openssl/pem.h>
#include <openssl/rand.h>
#include <openssl/x509.h>
#include <openssl/x509_vfy.h>
#include <openssl/x509v3.h>

#include <algorithm>
#include <cctype>
#include <climits>
#include <ctime>
#include <memory>

namespace farpoint {

namespace {

template <auto Free>
struct Deleter {
  template <typename T>
  void operator()(T* object) const {
    Free(object);
  }
};
void FreeNames(GENERAL_NAMES* names) { GENERAL_NAMES_free(names); }
void FreeCertificates(STACK_OF(X509) * stack) { sk_X509_pop_free(stack, X509_free); }

using BioPtr = std::unique_ptr<BIO, Deleter<BIO_free_all>>;
using X509Ptr = std::unique_ptr<X509, Deleter<X509_free>>;
using KeyPtr = std::unique_ptr<EVP_PKEY, Deleter<EVP_PKEY_free>>;
using StorePtr = std::unique_ptr<X509_STORE, Deleter<X509_STORE_free>>;
using StoreContextPtr = std::unique_ptr<X509_STORE_CTX, Deleter<X509_STORE_CTX_free>>;
using NamesPtr = std::unique_ptr<GENERAL_NAMES, Deleter<FreeNames>>;
using StackPtr = std::unique_ptr<STACK_OF(X509), Deleter<FreeCertificates>>;
using ExtensionPtr = std::unique_ptr<X509_EXTENSION, Deleter<X509_EXTENSION_free>>;
using NumberPtr = std::unique_ptr<BIGNUM, Deleter<BN_free>>;

constexpr size_t kMaxPemBytes = size_t{1} << 20;
// More between a certificate and its authority is not needed here, and takes time to check.
constexpr size_t kMaxChain = 8;
constexpr int kSerialBytes = 16;

absl::Status LibraryError(std::string_view what) {
  char text[256] = "no reason given";
  if (const unsigned long code = ERR_get_error(); code != 0) {
    ERR_error_string_n(code, text, sizeof(text));
  }
  ERR_clear_error();
  return absl::InternalError(std::string(what) + " failed: " + text);
}

BioPtr Reader(std::string_view text) {
  return BioPtr(
      BIO_new_mem_buf(text.data(), static_cast<int>(std::min(text.size(), kMaxPemBytes))));
}
std::string Written(BIO* bio) {
  const char* data = nullptr;
  const long size = BIO_get_mem_data(bio, &data);
  return size <= 0 ? std::string() : std::string(data, static_cast<size_t>(size));
}

std::vector<X509Ptr> ReadAll(std::string_view pem, size_t max) {
  std::vector<X509Ptr> all;
  const BioPtr bio = Reader(pem);
  while (bio && all.size() < max) {
    X509Ptr one(PEM_read_bio_X509(bio.get(), nullptr, nullptr, nullptr));
    if (!one) break;
    all.push_back(std::move(one));
  }
  ERR_clear_error();
  return all;
}

int64_t SecondsOf(const ASN1_TIME* time) {
  std::tm parts{};
  if (time == nullptr || ASN1_TIME_to_tm(time, &parts) != 1) return 0;
  return static_cast<int64_t>(::timegm(&parts));
}

std::string CommonName(X509_NAME* name) {
  char text[256];
  const int size = X509_NAME_get_text_by_NID(name, NID_commonName, text, sizeof(text));
  if (size <= 0) return "";
  // It is shown and logged: nothing that could pass for another line or name.
  std::string clean(text, std::min<size_t>(static_cast<size_t>(size), sizeof(text) - 1));
  for (char& c : clean) {
    if (static_cast<unsigned char>(c) < 0x20 || static_cast<unsigned char>(c) > 0x7e) c = '?';
  }
  return clean;
}

std::string TextOf(const ASN1_STRING* text) {
  return std::string(reinterpret_cast<const char*>(ASN1_STRING_get0_data(text)),
                     static_cast<size_t>(ASN1_STRING_length(text)));
}

CertificateFacts FactsOf(X509* certificate) {
  CertificateFacts facts;
  facts.name = CommonName(X509_get_subject_name(certificate));
  facts.issuer = CommonName(X509_get_issuer_name(certificate));
  facts.not_before_s = SecondsOf(X509_get0_notBefore(certificate));
  facts.not_after_s = SecondsOf(X509_get0_notAfter(certificate));
  facts.authority = X509_check_ca(certificate) == 1;
  const NumberPtr serial(ASN1_INTEGER_to_BN(X509_get0_serialNumber(certificate), nullptr));
  if (char* hex = serial ? BN_bn2hex(serial.get()) : nullptr; hex != nullptr) {
    facts.serial = hex;
    OPENSSL_free(hex);
    for (char& c : facts.serial) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  }
  const NamesPtr names(static_cast<GENERAL_NAMES*>(
      X509_get_ext_d2i(certificate, NID_subject_alt_name, nullptr, nullptr)));
  bool several = false;
  for (int i = 0; names && i < sk_GENERAL_NAME_num(names.get()); ++i) {
    const GENERAL_NAME* name = sk_GENERAL_NAME_value(names.get(), i);
    if (name->type == GEN_URI) {
      const std::optional<Role> role = RoleFromUri(TextOf(name->d.uniformResourceIdentifier));
      if (!role) continue;
      several = several || (facts.role != Role::kNone && facts.role != *role);
      facts.role = *role;
    } else if (name->type == GEN_DNS) {
      facts.hosts.push_back(TextOf(name->d.dNSName));
    } else if (name->type == GEN_IPADD) {
      char text[INET6_ADDRSTRLEN] = "";
      const std::string bytes = TextOf(name->d.iPAddress);
      const int family = bytes.size() == 4 ? AF_INET : AF_INET6;
      if (bytes.size() == 4 || bytes.size() == 16) {
        ::inet_ntop(family, bytes.data(), text, sizeof(text));
        facts.hosts.emplace_back(text);
      }
    }
  }
  // Two roles in one certificate would make it a matter of order which one counts.
  if (several) facts.role = Role::kNone;
  ERR_clear_error();
  return facts;
}

absl::StatusOr<X509Ptr> ReadFirst(std::string_view pem, std::string_view what) {
  std::vector<X509Ptr> all = ReadAll(pem, 1);
  if (all.empty()) {
    return absl::InvalidArgumentError(std::string(what) +
                                      ": holds no certificate in PEM form; is it the right file?");
  }
  return std::move(all[0]);
}

absl::StatusOr<KeyPtr> ReadKey(std::string_view pem, std::string_view what) {
  const BioPtr bio = Reader(pem);
  // Without the callback the library would ask at the terminal for the password of an encrypted
  // key.
  KeyPtr key(PEM_read_bio_PrivateKey(
      bio.get(), nullptr, [](char*, int, int, void*) { return 0; }, nullptr));
  ERR_clear_error();
  if (!key) {
    return absl::InvalidArgumentError(
        std::string(what) +
        ": holds no private key in PEM form, or one with a password; is it the "
        "right file?");
  }
  return key;
}

std::string Described(const CertificateFacts& facts) {
  return "the certificate of '" + facts.name + "'";
}

absl::Status Refusal(int error, const CertificateFacts& facts, std::string_view authorities,
                     int64_t now_s) {
  const std::string who = Described(facts);
  switch (error) {
    case X509_V_ERR_CERT_HAS_EXPIRED:
      if (facts.not_after_s > now_s) {
        return absl::UnauthenticatedError("the authority '" + facts.issuer + "' of " + who +
                                          " has expired; make a new one with farpoint certs init");
      }
      return absl::UnauthenticatedError(
          who + " expired on " + UtcText(facts.not_after_s) + ", it is " + UtcText(now_s) +
          "; make a new one with farpoint certs add, or set the clock");
    case X509_V_ERR_CERT_NOT_YET_VALID:
      return absl::UnauthenticatedError(who + " is not valid before " +
                                        UtcText(facts.not_before_s) + ", but it is " +
                                        UtcText(now_s) + "; set the clocks of both machines");
    case X509_V_ERR_UNABLE_TO_GET_ISSUER_CERT:
    case X509_V_ERR_UNABLE_TO_GET_ISSUER_CERT_LOCALLY:
    case X509_V_ERR_UNABLE_TO_VERIFY_LEAF_SIGNATURE:
    case X509_V_ERR_DEPTH_ZERO_SELF_SIGNED_CERT:
    case X509_V_ERR_SELF_SIGNED_CERT_IN_CHAIN:
    case X509_V_ERR_CERT_SIGNATURE_FAILURE:
    case X509_V_ERR_CERT_UNTRUSTED: {
      const auto known = ReadCertificate(authorities, "");
      return absl::UnauthenticatedError(
          who + " was issued by '" + facts.issuer + "', not by this farm's authority" +
          (known.ok() ? " '" + known->name + "'" : std::string()) +
          "; use the certificates of one farpoint certs init on all machines");
    }
    case X509_V_ERR_INVALID_PURPOSE:
      return absl::UnauthenticatedError(who +
                                        " is not made for this side of a connection; use a "
                                        "server's for a coordinator, another one for all else");
    default:
      return absl::UnauthenticatedError(who +
                                        " does not hold: " + X509_verify_cert_error_string(error) +
                                        "; make a new one with farpoint certs add");
  }
}

absl::StatusOr<KeyPtr> NewKey() {
  KeyPtr key(EVP_EC_gen("P-256"));
  if (!key) return LibraryError("making a key");
  return key;
}

absl::Status AddExtension(X509* certificate, X509* issuer, int nid, const std::string& value) {
  X509V3_CTX context;
  X509V3_set_ctx(&context, issuer, certificate, nullptr, nullptr, 0);
  const ExtensionPtr extension(X509V3_EXT_conf_nid(nullptr, &context, nid, value.c_str()));
  if (!extension || X509_add_ext(certificate, extension.get(), -1) != 1) {
    return LibraryError("the extension " + value);
  }
  return absl::OkStatus();
}

absl::StatusOr<X509Ptr> NewCertificate(const std::string& name, EVP_PKEY* key, int64_t not_before_s,
                                       int64_t not_after_s) {
  X509Ptr certificate(X509_new());
  unsigned char serial[kSerialBytes];
  if (!certificate || RAND_bytes(serial, sizeof(serial)) != 1) return LibraryError("a certificate");
  serial[0] = static_cast<unsigned char>((serial[0] & 0x7f) | 0x40);  // positive, of full length
  const NumberPtr number(BN_bin2bn(serial, sizeof(serial), nullptr));
  X509_NAME* subject = X509_get_subject_name(certificate.get());
  const auto* text = reinterpret_cast<const unsigned char*>(name.c_str());
  const bool done =
      number != nullptr &&
      BN_to_ASN1_INTEGER(number.get(), X509_get_serialNumber(certificate.get())) != nullptr &&
      X509_set_version(certificate.get(), X509_VERSION_3) == 1 &&
      ASN1_TIME_set(X509_getm_notBefore(certificate.get()), not_before_s) != nullptr &&
      ASN1_TIME_set(X509_getm_notAfter(certificate.get()), not_after_s) != nullptr &&
      X509_NAME_add_entry_by_txt(subject, "CN", MBSTRING_UTF8, text, -1, -1, 0) == 1 &&
      X509_set_pubkey(certificate.get(), key) == 1;
  if (!done) return LibraryError("a certificate");
  return certificate;
}

absl::StatusOr<CertificateAndKey> Signed(X509* certificate, EVP_PKEY* own_key, EVP_PKEY* signer) {
  if (X509_sign(certificate, signer, EVP_sha256()) == 0)
    return LibraryError("signing a certificate");
  const BioPtr cert_bio(BIO_new(BIO_s_mem())), key_bio(BIO_new(BIO_s_mem()));
  if (!cert_bio || !key_bio || PEM_write_bio_X509(cert_bio.get(), certificate) != 1 ||
      PEM_write_bio_PKCS8PrivateKey(key_bio.get(), own_key, nullptr, nullptr, 0, nullptr,
                                    nullptr) != 1) {
    return LibraryError("writing a certificate");
  }
  return CertificateAndKey{Written(cert_bio.get()), Written(key_bio.get())};
}

bool IsIpAddress(const std::string& host) {
  unsigned char bytes[16];
  return ::inet_pton(AF_INET, host.c_str(), bytes) == 1 ||
         ::inet_pton(AF_INET6, host.c_str(), bytes) == 1;
}

// It goes into a line that the library parses: commas and colons would end the name.
absl::Status CheckHostName(const std::string& host) {
  const bool good =
      IsIpAddress(host) ||
      (!host.empty() && host.size() <= 253 && std::all_of(host.begin(), host.end(), [](char c) {
        return std::isalnum(static_cast<unsigned char>(c)) != 0 || c == '-' || c == '.' ||
               c == '*' || c == '_';
      }));
  if (good) return absl::OkStatus();
  return absl::InvalidArgumentError("'" + host.substr(0, 260) +
                                    "' is neither the name of a machine nor an IP address");
}

}  // namespace

absl::StatusOr<CertificateFacts> ReadCertificate(std::string_view pem, std::string_view what) {
  FP_ASSIGN_OR_RETURN(const X509Ptr certificate, ReadFirst(pem, what));
  return FactsOf(certificate.get());
}

absl::Status CheckIssued(std::string_view pem, std::string_view authorities, bool server,
                         int64_t now_s) {
  std::vector<X509Ptr> chain = ReadAll(pem, kMaxChain);
  if (chain.empty()) return absl::UnauthenticatedError("no certificate that could be read");
  const StorePtr store(X509_STORE_new());
  if (!store) return LibraryError("a store of certificates");
  const std::vector<X509Ptr> trusted = ReadAll(authorities, SIZE_MAX);
  if (trusted.empty())
    return absl::FailedPreconditionError("there is no authority to check against");
  for (const X509Ptr& one : trusted) X509_STORE_add_cert(store.get(), one.get());
  const StackPtr between(sk_X509_new_null());
  const StoreContextPtr context(X509_STORE_CTX_new());
  if (!between || !context) return LibraryError("checking a certificate");
  const CertificateFacts facts = FactsOf(chain[0].get());
  for (size_t i = 1; i < chain.size(); ++i) {
    if (sk_X509_push(between.get(), chain[i].get()) > 0) chain[i].release();
  }
  if (X509_STORE_CTX_init(context.get(), store.get(), chain[0].get(), between.get()) != 1) {
    return LibraryError("checking a certificate");
  }
  X509_VERIFY_PARAM* const rules = X509_STORE_CTX_get0_param(context.get());
  X509_VERIFY_PARAM_set_time(rules, static_cast<time_t>(now_s));
  X509_VERIFY_PARAM_set_depth(rules, static_cast<int>(kMaxChain));
  X509_VERIFY_PARAM_set_auth_level(rules, 1);
  if (X509_VERIFY_PARAM_set_purpose(
          rules, server ? X509_PURPOSE_SSL_SERVER : X509_PURPOSE_SSL_CLIENT) != 1) {
    return LibraryError("checking a certificate");
  }
  const bool good = X509_verify_cert(context.get()) == 1;
  const int error = X509_STORE_CTX_get_error(context.get());
  ERR_clear_error();
  if (good && error == X509_V_OK) return absl::OkStatus();
  return Refusal(error, facts, authorities, now_s);
}

absl::Status CheckKey(std::string_view pem, std::string_view key, std::string_view what) {
  FP_ASSIGN_OR_RETURN(const X509Ptr certificate, ReadFirst(pem, what));
  FP_ASSIGN_OR_RETURN(const KeyPtr read, ReadKey(key, what));
  const bool match = X509_check_private_key(certificate.get(), read.get()) == 1;
  ERR_clear_error();
  if (match) return absl::OkStatus();
  return absl::FailedPreconditionError(std::string(what) + ": is not the key of " +
                                       Described(FactsOf(certificate.get())) +
                                       "; take certificate and key that were made together");
}

absl::Status CheckHost(std::string_view pem, const std::string& host) {
  FP_ASSIGN_OR_RETURN(const X509Ptr certificate, ReadFirst(pem, "the coordinator"));
  const bool named = IsIpAddress(host) ? X509_check_ip_asc(certificate.get(), host.c_str(), 0) == 1
                                       : X509_check_host(certificate.get(), host.data(),
                                                         host.size(), 0, nullptr) == 1;
  ERR_clear_error();
  if (named) return absl::OkStatus();
  const CertificateFacts facts = FactsOf(certificate.get());
  std::string hosts;
  for (const std::string& one : facts.hosts) hosts += (hosts.empty() ? "" : ", ") + one;
  return absl::UnauthenticatedError(
      Described(facts) + " names " + (hosts.empty() ? std::string("no host") : hosts) + ", not '" +
      host + "'; use one of those names, or make one that does: farpoint certs add NAME --server " +
      host);
}

absl::StatusOr<CertificateAndKey> MakeAuthority(const std::string& name, int64_t not_before_s,
                                                int64_t not_after_s) {
  FP_RETURN_IF_ERROR(CheckName(name));
  FP_ASSIGN_OR_RETURN(const std::string digits, RandomHexDigits(8));
  FP_ASSIGN_OR_RETURN(const KeyPtr key, NewKey());
  FP_ASSIGN_OR_RETURN(const X509Ptr certificate,
                      NewCertificate(name + " " + digits, key.get(), not_before_s, not_after_s));
  X509* const c = certificate.get();
  if (X509_set_issuer_name(c, X509_get_subject_name(c)) != 1) return LibraryError("a certificate");
  FP_RETURN_IF_ERROR(AddExtension(c, c, NID_basic_constraints, "critical,CA:TRUE,pathlen:0"));
  FP_RETURN_IF_ERROR(AddExtension(c, c, NID_key_usage, "critical,keyCertSign,cRLSign"));
  FP_RETURN_IF_ERROR(AddExtension(c, c, NID_subject_key_identifier, "hash"));
  return Signed(c, key.get(), key.get());
}

absl::StatusOr<CertificateAndKey> IssueCertificate(const CertificateAndKey& authority,
                                                   const CertificateRequest& request) {
  FP_RETURN_IF_ERROR(CheckName(request.name));
  if (request.role == Role::kNone) {
    return absl::InvalidArgumentError(
        "a certificate needs a role: server, worker, client or admin");
  }
  const bool server = request.role == Role::kServer;
  if (server == request.hosts.empty()) {
    return absl::InvalidArgumentError(server ? "a server's certificate names at least one host"
                                             : "only a server's certificate names hosts");
  }
  std::string names = "URI:" + RoleUri(request.role);
  for (const std::string& host : request.hosts) {
    FP_RETURN_IF_ERROR(CheckHostName(host));
    names += (IsIpAddress(host) ? ",IP:" : ",DNS:") + host;
  }
  FP_RETURN_IF_ERROR(CheckKey(authority.certificate, authority.key, "the authority's key"));
  FP_ASSIGN_OR_RETURN(const X509Ptr issuer, ReadFirst(authority.certificate, "the authority"));
  FP_ASSIGN_OR_RETURN(const KeyPtr issuer_key, ReadKey(authority.key, "the authority's key"));
  FP_ASSIGN_OR_RETURN(const KeyPtr key, NewKey());
  const int64_t end = std::min(request.not_after_s, FactsOf(issuer.get()).not_after_s);
  FP_ASSIGN_OR_RETURN(const X509Ptr certificate,
                      NewCertificate(request.name, key.get(), request.not_before_s, end));
  X509* const c = certificate.get();
  if (X509_set_issuer_name(c, X509_get_subject_name(issuer.get())) != 1) {
    return LibraryError("a certificate");
  }
  FP_RETURN_IF_ERROR(AddExtension(c, issuer.get(), NID_basic_constraints, "critical,CA:FALSE"));
  FP_RETURN_IF_ERROR(AddExtension(c, issuer.get(), NID_key_usage, "critical,digitalSignature"));
  FP_RETURN_IF_ERROR(
      AddExtension(c, issuer.get(), NID_ext_key_usage, server ? "serverAuth" : "clientAuth"));
  FP_RETURN_IF_ERROR(AddExtension(c, issuer.get(), NID_subject_alt_name, names));
  FP_RETURN_IF_ERROR(AddExtension(c, issuer.get(), NID_subject_key_identifier, "hash"));
  FP_RETURN_IF_ERROR(AddExtension(c, issuer.get(), NID_authority_key_identifier, "keyid:always"));
  return Signed(c, key.get(), issuer_key.get());
}

absl::StatusOr<std::string> RandomHexDigits(size_t digits) {
  std::string bytes((digits + 1) / 2, '\0');
  if (RAND_bytes(reinterpret_cast<unsigned char*>(bytes.data()), static_cast<int>(bytes.size())) !=
      1) {
    return LibraryError("reading random numbers");
  }
  static constexpr char kDigits[] = "0123456789abcdef";
  std::string text;
  for (const char c : bytes) {
    const auto byte = static_cast<unsigned char>(c);
    text += kDigits[byte >> 4];
    text += kDigits[byte & 15];
  }
  text.resize(digits);
  return text;
}

}  // namespace farpoint
